"""A screened potential in a cube, 96^3, where the train wins, and a square, 256^2, where it loses::

    python docs/examples/yukawa.py yukawa.png

It is the second part of `run/demo`. The products are by FFT in all rows; the circulant is that of T. Chan.
"""

from comparison import compare, draw
from integral_problems import fredholm, yukawa

if __name__ == "__main__":
    cube = compare(yukawa(96), eps=None, dense=False)
    draw(**{"cube 96^3": cube, "square 256^2": compare(fredholm(256), eps=None, dense=False)})
