"""Into Gazebo's models: only the values we own change, every other byte stays."""
