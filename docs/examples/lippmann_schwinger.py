"""Scattering of a screened potential by a smooth ball, 64^3 and 128^3:
.venv/bin/python docs/examples/lippmann_schwinger.py"""

from comparison import compare
from problems import lippmann_schwinger

if __name__ == "__main__":
    for n in (64, 128):
        compare(lippmann_schwinger(n), eps=1e-5)
