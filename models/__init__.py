"""Bundled weights, their cards and recipes; installed as ``fmr_cli.models``."""
