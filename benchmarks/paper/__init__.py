"""The paper's results from runs of our own: see `__main__`."""
