"""Scenes whose colour, depth and free space are known, for tests and studies of this renderer or of any other.

`analytic` has media in closed form, `room` a furnished room of opaque surfaces, `house` three rooms and a terrace, and
`synthetic_capture` writes images of room or house as a dataset, with its ground truth. The wheel does not contain them.
A script imports them from a checkout:

    PYTHONPATH=experiments python -c "from test_scenes import analytic; print(analytic.slab(1.0, lower=0.0, upper=1.0))"
"""
