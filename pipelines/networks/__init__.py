"""Learned networks: the registry and download of their files, cards, and the runtimes that open them."""
