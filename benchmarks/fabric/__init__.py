"""Two relays' ends of a fabric, before there are relays on it: see `__main__`."""
