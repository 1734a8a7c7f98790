"""What is said on stderr: the log with -v, the traceback with --debug."""

from __future__ import annotations

import logging

import pytest

from fmr_cli.cli.console import show_log


@pytest.fixture
def logged(monkeypatch, fmr):
    """Runs `fmr align` where the library logs two lines, with further arguments; gives stderr's lines."""
    from fmr_cli.registration import pipeline

    align, log = pipeline.align, logging.getLogger("fmr_cli.registration.anywhere")

    def logging_align(*given, **more):
        log.info("settled by [features]")
        log.debug("a detail")
        return align(*given, **more)

    monkeypatch.setattr(pipeline, "align", logging_align)
    yield lambda *more: fmr("align", "scan_a.ply", "scan_b.ply", *more).stderr.splitlines()
    show_log(0)


def test_the_log_is_shown_as_far_as_it_is_asked_for(logged):
    assert not any("settled" in line or "detail" in line for line in logged())
    lines = logged("-v")
    assert "settled by [features]" in lines
    assert not any("a detail" in line for line in lines)
    assert lines[-1].startswith("aligned")
    assert any(line.endswith("fmr_cli.registration.anywhere: a detail") for line in logged("-vv", "-q"))


@pytest.mark.parametrize(
    "arguments", [("--debug", "align", "no.ply", "x.ply"), ("align", "no.ply", "x.ply", "--debug")]
)
def test_debug_shows_where_an_error_comes_from(fmr, arguments):
    done = fmr(*arguments)
    assert done.returncode == 2
    assert done.stderr.startswith("Traceback")
    assert done.stderr.splitlines()[-1].endswith("no.ply: no such file, check the name")
