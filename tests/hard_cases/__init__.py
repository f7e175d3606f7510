"""Hard cases: numerical errors known from released systems, each with a measurement and its bound.

    from hard_cases import ALL
    for case in ALL: print(case, *case.run(), sep="\\n    ")

A family is a file with cases(...), which takes the function under test, so that the same cases can test
another implementation (naive.py has those of the released codes). Inputs are float32; oracles are
float64 or longer, independent of jaxnerf: exact.py for compositing, formulas in the families' own files,
tests/oracle.py for SSIM.
"""

from hard_cases import cameras, compositing, encoding, importance, metrics, stratified
from hard_cases.checks import Case, Check

ALL = [
    *compositing.cases(),
    *compositing.cases(outputs="bfloat16"),
    *importance.cases(),
    *stratified.cases(),
    *encoding.cases(),
    *cameras.cases(),
    *metrics.cases(),
]

__all__ = ["ALL", "Case", "Check"]
