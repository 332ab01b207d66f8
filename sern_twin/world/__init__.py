"""The world of the twin: the paper's "Representing the Real Environment in the Virtual Twin". Pure.

grid        where the cells and blocks of a site lie, in its plane
mesh        triangles for a viewer
terrain     heights of an elevation raster on a grid
primitives  roads, buildings, water from the features of a map, on a grid and as meshes
occupancy   what scans and clouds say of each cell
patches     one block of a scene in bytes and back
scene       the layers of the world, which blocks changed, and what the patches of others did
offset      how far off an object is in another world
"""
