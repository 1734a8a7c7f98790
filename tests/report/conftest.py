"""A headless Chromium for pages, and results that pages are made of."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from fmr_cli import align, read_cloud

SAMPLES = Path(__file__).parents[2] / "samples"


@pytest.fixture(scope="session")
def pair():
    """The sample scans, thinned to a quarter, and their registration."""
    source, target = (read_cloud(SAMPLES / f"{name}.ply").select(slice(None, None, 4)) for name in ("scan_a", "scan_b"))
    return source, target, align(source, target)


@pytest.fixture
def doubtful(pair):
    """The same as if two other poses fitted as well and a direction were open."""
    source, target, found = pair
    others = []
    for shift, confidence in ((0.5, 0.3), (1.0, 0.2)):
        T = found.T_target_source.copy()
        T[0, 3] += shift
        others.append({"T_target_source": T.tolist(), "confidence": confidence, "feature_error": 0.1})
    open_way = "shift along (1.00, 0.00, 0.00)"
    return source, target, replace(
        found, status="uncertain", confidence=0.4, alternatives=others, undetermined=[open_way],
        reasons=[f"the scans do not determine: {open_way}", "fits about as well shifted by 0.5 along (1.0, 0.0, 0.0)"],
    )  # fmt: skip


@pytest.fixture(scope="session")
def chromium():
    """A browser without a network; tests that need it are skipped where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed: no browser tests")
    binary = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    driver = shutil.which("chromedriver")
    if binary is None or driver is None:
        pytest.skip("no Chromium with its chromedriver on this machine (Debian: apt install chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for argument in (
        "--headless=new",
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--window-size=1200,900",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--host-resolver-rules=MAP * ~NOTFOUND",
    ):
        options.add_argument(argument)  # fmt: skip
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
    browser.command_executor.client_config.timeout = 400  # a busy machine draws slowly
    browser.set_page_load_timeout(300)
    browser.set_script_timeout(120)
    yield browser
    browser.quit()


@pytest.fixture
def opened(chromium):
    """Opens a page; at the end nothing was complained of on its console, and nothing but the page was fetched."""

    def open_page(path: Path):
        chromium.get(path.as_uri())
        return chromium

    for log in ("browser", "performance"):
        chromium.get_log(log)  # empties it
    yield open_page
    assert [line for line in chromium.get_log("browser") if line["level"] == "SEVERE"] == []
    messages = [json.loads(line["message"])["message"] for line in chromium.get_log("performance")]
    urls = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert all(url.startswith(("file:", "data:", "blob:")) for url in urls), urls
