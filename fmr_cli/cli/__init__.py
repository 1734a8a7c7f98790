"""The command `fmr`: one module a command; `app.py` puts them together."""
