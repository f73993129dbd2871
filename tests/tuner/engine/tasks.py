"""Tasks that tests have workers compute."""

import logging
import os
import time
from pathlib import Path

from tuner.core.errors import RecordingError


def square(number, report):
    report({"number": number})
    return number * number


def about_the_process(_, report):
    del report
    return {
        "pid": os.getpid(),
        "cores": [
            sorted(os.sched_getaffinity(int(thread.name)))
            for thread in Path("/proc/self/task").iterdir()
        ],
    }


def refused(path, report):
    del report
    raise RecordingError(path, "is empty", "record it again")


def logged(line, report):
    del report
    logging.getLogger("tuner.anything").warning("%s", line)


def value_of(shared, report):
    del report
    return shared()


def until_stopped(file, report):
    """Report for as long as anyone listens; leave a file when nobody does any more."""
    try:
        for number in range(600):
            report(number)
            time.sleep(0.05)
    finally:
        Path(file).touch()


def takes_ever_more(_, report):
    """Take memory until somebody objects, or 4 GiB."""
    taken = []
    for number in range(256):
        taken.append(bytearray(os.urandom(2**12) * 2**12))
        report(number)
        time.sleep(0.02)


def dies_at_first(file, report):
    """End the process that computes this for the first time."""
    del report
    if not Path(file).exists():
        Path(file).touch()
        os._exit(1)
    return "done"


def dies(_, report):
    del report
    os._exit(1)
