"""Compact equivalents of heavy messages (paper, "Distribution of ROS Data", idea 3, "Compact state exchange").

Everything here is a function of bytes: a serialised ROS message in, a serialised ROS message out, in either encoding
(`ros1` or `cdr`). What cannot be read raises BodyError and nothing else.

| module | from | to |
|---|---|---|
| `voxel` | sensor_msgs/PointCloud2 | sensor_msgs/PointCloud2, one point a voxel |
| `scan` | sensor_msgs/PointCloud2 | sensor_msgs/LaserScan, the paper's S_2D |
| `mask` | sensor_msgs/PointCloud2 | nav_msgs/OccupancyGrid around the robot |
| `patches` | nav_msgs/OccupancyGrid | itself, then map_msgs/OccupancyGridUpdate; and back |
| `transforms` | tf2_msgs/TFMessage | tf2_msgs/TFMessage, the newest of each pair of frames |

`bodies`, `clouds` and `grids` read and write the fixed layouts straight from the bytes.
"""
