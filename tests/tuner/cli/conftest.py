from tests.tuner.export.conftest import make_run

__all__ = ["make_run"]
