"""The doors: where people and other programs come in, and where errors are told in one line."""
