"""The simulated flight of a PX4 quadcopter: pure functions on immutable pytrees.

World is ENU, body is FLU (x forward, y left, z up), quaternions are (w, x, y, z) body to world,
units are SI. Every function is written on scalar components and broadcasts over any trailing batch
axes, so that one source serves one vehicle and a batch whose axis lies last in memory.
"""
