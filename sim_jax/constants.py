"""Constants of nature and of units."""

import math

GRAVITY = 9.81
"""m/s², along −z of the world, as Gazebo's."""
RAD_S_PER_RPM = 2 * math.pi / 60
"""rad/s per revolution a minute."""
