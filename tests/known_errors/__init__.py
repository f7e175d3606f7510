"""Known maximum errors of the public functions of jaxnerf.core: rows, their exact values, and a search for bad inputs.

    from known_errors import ROWS, search
    for row in ROWS: print(row, search.climb(search.Meter(row), generations=20))

A row is a function on inputs from a stated range, beside an independent formula in float64. The error of a result is
counted in units of

    2^-23 |result| + the largest change of the exact result when every input moves by half a unit in its last place,

so that an error of 1 is what rounding the inputs and the result explains, whatever the condition number there. It is
the mixed error of numerical analysis (Higham 2002, Section 1.5), and for a well-conditioned function the ulp in which
glibc's manual states its "known maximum errors". Where a function jumps, the error is backward: the smallest number of
half units by which the inputs must move for the exact result to pass the computed one.

The search follows Gladman, Innocente, Mather and Zimmermann, "Accuracy of Mathematical Functions in Single, Double,
Extended Double and Quadruple Precision" (hal-03141101): no exhaustive search being possible, the largest errors found
are lower bounds. As in CORE-MATH, the inputs that gave them are kept (bounds.json) and tested again.
"""

from known_errors import cameras, compositing, images, sampling
from known_errors.rows import Row

ROWS: list[Row] = [*cameras.rows(), *sampling.rows(), *compositing.rows(), *images.rows()]

__all__ = ["ROWS", "Row"]
