"""What the files of a store are called; whoever checks a configuration need not load SQLite."""

from typing import Final

DURABLE_FILE: Final = "durable.sqlite"
