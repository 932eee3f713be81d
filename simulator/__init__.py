"""Experiments over the link: the one package that knows both ends."""
