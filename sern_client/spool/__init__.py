"""Store and forward: what a robot keeps of its topics (`keeping`, `serving`), and what a site fetches of it."""
