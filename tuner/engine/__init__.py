"""Where independent work is computed: in this process, in local ones, or on a Dask cluster."""

from tuner.engine.engine import HERE, Engine, Here, Report, current, engine_for, using

__all__ = ["HERE", "Engine", "Here", "Report", "current", "engine_for", "using"]
