"""A Fredholm equation of the second kind on a square of 1024^2 points, solved in several ways::

    python docs/examples/fredholm.py fredholm.png
"""

from comparison import compare, draw
from integral_problems import fredholm

if __name__ == "__main__":
    draw(Fredholm=compare(fredholm(1024), eps=1e-9))
