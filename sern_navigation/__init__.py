"""A robot finds its way: the paper's "Environmental Perception and Navigation Planning". Pure, with numpy and scipy.

scan               the obstacle scan of a cloud: what stands in the way at each bearing, and where the ground ends
matching           where a scan fits on the map
mapping            the map that scans make, and the robot's place on it
costmap            what each cell costs: the map, real obstacles, inflation, and what the twin says
global_plan        the cheapest way over the costmap
critics            what is good and bad about a trajectory
mppi               the next command: many random trajectories, and their mean by merit
collision_monitor  the last word on a command, by real data alone
recovery           what a robot tries that is stuck
navigator          a goal, and the command of each cycle until it is reached or given up

Parameters that Nav2 has are called as in Nav2 and mean the same; units are metres, seconds and radians throughout.
It needs the extra `twin`, for scipy.
"""
