"""Summaries that go in place of heavy messages, or beside them."""
