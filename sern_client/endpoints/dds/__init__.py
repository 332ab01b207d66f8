"""ROS 2 over DDS, without ROS: topics and services of rmw_fastrtps, rmw_cyclonedds and others, by Cyclone DDS.

names, qos, graph   pure: what ROS 2 means by DDS names and policies; who is there, and who does not match whom
idl, raw, domain    types made at run time; bytes in and out of DDS; domains of this process
worker              the thread that waits for DDS
entities            our participant: its readers and writers, and what the others are told of them
subscription        a topic on its way to the link
endpoint, services  the endpoint of the bridge
"""
