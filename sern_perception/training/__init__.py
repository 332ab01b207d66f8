"""How the network that comes with SERN was made: `python -m sern_perception.training`. Needs `sern[train,sim]`."""
