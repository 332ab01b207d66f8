"""A node that drives a robot to its goals: `sern_navigation` behind an endpoint, as `sern-navigation` runs it.

options      what it is told by its file
hearing      bodies of clouds, odometry, maps and goals, as the navigator reads them
localising   where the robot is, by its odometry and by what its scans fit
writing      bodies of commands, paths, maps and states
action       the action navigate_to_pose
planning     plans, made in a process of their own
node         what comes of it, ten times a second
"""
