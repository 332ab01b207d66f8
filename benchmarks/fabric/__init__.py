"""Several relays, and two of their ends before there are relays on them: see `__main__`."""
