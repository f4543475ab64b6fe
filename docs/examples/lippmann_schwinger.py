"""Scattering of a screened potential by a smooth ball, on 64^3 and 128^3 points::

    python docs/examples/lippmann_schwinger.py lippmann_schwinger.png
"""

from comparison import compare, draw
from integral_problems import lippmann_schwinger

if __name__ == "__main__":
    small = compare(lippmann_schwinger(64), eps=1e-5)
    large = compare(lippmann_schwinger(128), eps=None)  # as operator a train of rank 122 takes seconds per product
    draw(**{"64^3 points": small, "128^3 points": large})
