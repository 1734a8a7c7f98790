"""``python -m fmr_cli.cli``: the ``fmr`` command where it is not on the path."""

from fmr_cli.cli.app import main

main()
