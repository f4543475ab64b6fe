"""A Fredholm equation of the second kind on a square, 1024^2: .venv/bin/python docs/examples/fredholm.py"""

from comparison import compare
from integral_problems import fredholm

if __name__ == "__main__":
    compare(fredholm(1024), eps=1e-9)
