"""The virtual twin: where things are, how fine they are kept, and what is known of a robot that is not heard. Pure.

geodesy       from latitude and longitude to metres at the site, and from there to the axes of Unity
world         the ground, the map and what robots see of a site, and the patches that say what changed
detail        which blocks of the scene are kept at which level of detail
motion        the state of a ground robot, and how it moves on
slip          what a skid-steered robot makes of a command, learned while it is heard
trajectory    a plan that robot and twin both have
predictors    how the twin goes on while nothing is heard
synchroniser  the twin of one robot: what is taken, predicted, shown, and said of it
reckoning     when a robot is to send its pose
correction    how the shown twin is led back to the robot after a gap
bound         how far the twin can be from the robot after a gap, and whether that was kept
"""
