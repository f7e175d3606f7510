"""What the tables and the plot of speed_vs_error.py are made of: pure functions of what was measured."""

import math
import statistics

import numpy as np


def pareto_front(points):
    """Returns the (cost, value) that no other beats in one without losing in the other, cheapest first."""
    front = []
    for cost, value in sorted(points, key=lambda point: (point[0], -point[1])):
        if not front or value > front[-1][1]:
            front.append((cost, value))
    return front


def first_reached(points, bar, key="seconds"):
    """Returns the time at which the first of a run's points scored at least a bar, or infinity."""
    return min((point[key] for point in points if point["psnr"] >= bar), default=math.inf)


def slope(values, costs):
    """Returns the exponent p of costs ~ values^p: 1 is linear."""
    return float(np.polyfit(np.log(values), np.log(costs), 1)[0])


def medians(runs):
    """Returns the points of a curve: at each time that all its runs were scored at, the medians."""
    stops = sorted(set.intersection(*({point["stop"] for point in points} for points in runs.values())))
    found = []
    for stop in stops:
        same = [point for points in runs.values() for point in points if point["stop"] == stop]
        numbers = [key for key, value in same[0].items() if isinstance(value, (int, float))]
        found.append({key: statistics.median(point[key] for point in same) for key in numbers})
        found[-1]["seeds"] = [point["psnr"] for point in same]
    return found
