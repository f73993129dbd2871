"""Where independent work is computed: in this process, in local ones, or on a Dask cluster."""

from tuner.engine.engine import HERE, Engine, InProcessEngine, Report, current, engine_for, using

__all__ = ["HERE", "Engine", "InProcessEngine", "Report", "current", "engine_for", "using"]
