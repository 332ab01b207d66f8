"""What a robot's clouds show: range images, their classes by a small network, and whatever stands in the way.

`projection` and `detector` need numpy and scipy; `segmenter` needs the extra `seg`; `training` needs the extra `train`.
Nothing here has a clock or a network, and randomness is handed in.
"""
