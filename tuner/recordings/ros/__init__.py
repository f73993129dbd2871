"""ROS recordings: ROS 1 bags, ROS 2 databases and MCAP, without ROS."""
