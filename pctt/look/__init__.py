"""Figures, pictures and files for ParaView from the output folder of a run.

The programs are ``python -m pctt.plot``, ``pctt.render`` and ``pctt.export``.
"""
