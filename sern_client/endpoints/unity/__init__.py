"""Scenes of Unity as an endpoint, by the protocol of Unity's ROS-TCP-Connector; no ROS is needed.

frames        bytes from and to a scene, cut into frames; no I/O
commands      what a scene asks for, and what it is told
names         how topics and types are called there and here
outbox        what waits for one scene
scene         one connection: reads, writes, keeps alive
faults        what is wrong with what scenes say: counted, told to the scene, logged once
incoming      topics of other sites, for the scenes that subscribe to them
publications  topics that scenes publish
far_services, own_services  services of other sites, and those of scenes
ages          how old topics are
endpoint      all of it
"""
