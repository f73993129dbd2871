"""Compiled kernels from jax functions: a function of one lane, run over many lanes side by side.

A jaxpr is walked once and written as LLVM IR in which every number is a vector of lanes. Loops stay
loops, conditions on what all lanes share are branches, small arrays live in registers. A program
that XLA compiles in half a minute is built in a second or two. Lengths of loops and tables are
arguments: one program serves recordings of any length.

`Program` is the entry: it takes the function, says which arguments belong to a lane, and runs in
blocks of lanes on several threads. A function with a primitive that has no rule runs
through `jax.vmap` and XLA instead. Nothing here knows of multirotors.
"""

from lanes.dependence import dependent
from lanes.layout import Argument
from lanes.machine import keep_code_in
from lanes.program import Program, ProgramResults, joined, program_of

__all__ = [
    "Argument",
    "Program",
    "ProgramResults",
    "dependent",
    "joined",
    "keep_code_in",
    "program_of",
]
