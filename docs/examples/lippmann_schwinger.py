"""Scattering of a screened potential by a smooth ball, 64^3 and 128^3:
.venv/bin/python docs/examples/lippmann_schwinger.py"""

from comparison import compare
from integral_problems import lippmann_schwinger

if __name__ == "__main__":
    compare(lippmann_schwinger(64), eps=1e-5)
    compare(lippmann_schwinger(128), eps=None)  # as operator a train of rank 122 takes seconds per product
