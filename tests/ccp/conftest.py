"""Every test starts from an empty PETSc options database."""

from empty_options import database as database
