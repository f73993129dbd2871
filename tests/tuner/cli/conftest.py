from tests.tuner.exporters.conftest import make_run

__all__ = ["make_run"]
