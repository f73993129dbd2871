"""Constants of nature as the simulator has them."""

GRAVITY = 9.81
"""m/s², along −z of the world, as Gazebo's."""
