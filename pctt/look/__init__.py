"""What a person looks at, made from the output folder of a run: reading it, surfaces, figures, command lines.

The programs are ``python -m pctt.plot``, ``pctt.render`` and ``pctt.export``.
"""
