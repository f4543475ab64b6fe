# Copyright Spack Project Developers. See COPYRIGHT file for details.
#
# SPDX-License-Identifier: (Apache-2.0 OR MIT)
#
# For spack/spack-packages, repos/spack_repo/builtin/packages/py_pctt/package.py: the filled copy that `run/release` writes.

from spack_repo.builtin.build_systems.python import PythonPackage

from spack.package import *


class PyPctt(PythonPackage):
    """Nonsmooth rigid body dynamics on PETSc: cone complementarity problems with friction, and tensor-train
    preconditioners for any PETSc matrix."""

    homepage = "@address@"
    pypi = "pctt/pctt-@version@.tar.gz"
    git = "@address@.git"

    maintainers("@maintainer@")

    license("BSD-2-Clause")

    version("main", branch="main")
    version("@version@", sha256="@sha256@")

    variant("figures", default=False, description="Figures of a run")
    variant("mumps", default=True, description="Factorisations on several ranks, for accurate solutions")

    depends_on("python@3.9:", type=("build", "run"))
    depends_on("py-hatchling@1.27:", type="build")

    with default_args(type=("build", "run")):
        depends_on("py-numpy@1.22:")
        depends_on("py-scipy@1.8:")
        depends_on("py-h5py@3.6:")
        depends_on("py-numba@0.56:")
        depends_on("py-mpi4py@3.1:")
        depends_on("py-petsc4py@3.18:+mpi")

        depends_on("py-matplotlib@3.6:", when="+figures")

    depends_on("petsc@3.18:+mpi+double~complex")
    depends_on("petsc+mumps", when="+mumps")
