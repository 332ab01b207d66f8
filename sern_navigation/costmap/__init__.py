"""What each cell costs a robot that drives over it: the layers of Nav2's costmap, and one of the twin.

costs      the values of cells, and the costmap that planner and controller read
inflation  costs around obstacles
static     the map
obstacles  what real scans mark and clear
twin       what the twin says, as costs alone
escape     costs for a robot that touches something
layered    the layers together
"""
