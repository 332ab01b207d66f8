"""The scene that sites share: what robots see and what people add, as one map at each of them."""
