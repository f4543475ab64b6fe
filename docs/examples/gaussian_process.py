"""Gaussian process regression on a grid of 256^2 points: short correlations, and a long one, where a train does not
win::

    python docs/examples/gaussian_process.py gaussian_process.png
"""

from comparison import compare, draw
from integral_problems import gaussian_process

if __name__ == "__main__":
    draw(**{f"width {width}": compare(gaussian_process(256, width), eps=1e-9) for width in (0.01, 0.02, 0.1)})
