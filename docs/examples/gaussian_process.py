"""Gaussian process regression on a grid of 256^2 points: a short correlation, and a long one, where a train does not
win: .venv/bin/python docs/examples/gaussian_process.py"""

from comparison import compare
from integral_problems import gaussian_process

if __name__ == "__main__":
    for width in (0.01, 0.02, 0.1):
        compare(gaussian_process(256, width), eps=1e-9)
