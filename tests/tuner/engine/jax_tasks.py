"""A task whose module imports jax, as those that compute do."""

import lanes.machine


def folders_of_kernels():
    """Return where this process keeps kernels: nowhere before jax is set up."""
    return list(lanes.machine._folder)


class WhenRead:
    """Becomes what `folders_of_kernels` returns where it is unpickled."""

    def __reduce__(self):
        return folders_of_kernels, ()


def given(argument, report):
    del report
    return argument
