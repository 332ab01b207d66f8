"""The twins in a browser: what is to be seen (`frames`, `history`, `blocks`), drawn (`scene`) and served (`server`)."""
