"""The default options of the Krylov methods and preconditioners of Newton systems; those of the user replace them."""

Options = dict[str, str]

#: by the form of the systems
DEFAULTS: dict[str, Options] = {
    "contact": {"ksp_type": "bcgs", "pc_type": "pbjacobi"},
    "kkt": {"ksp_type": "bcgs", "pc_type": "pbjacobi"},
    "body": {"ksp_type": "cg", "ksp_norm_type": "unpreconditioned", "pc_type": "pbjacobi"},
}
#: of a problem that is given by N: a solve as accurate as that of the bodies would be
GIVEN: Options = {"ksp_type": "gmres", "pc_type": "cholesky"}
#: in place of these, by the preconditioner, for systems that are not symmetric
UNSYMMETRIC: dict[str, Options] = {"pbjacobi": {"ksp_type": "bcgs"}, "cholesky": {"pc_type": "lu"}}
#: where block Jacobi takes long on contacts
INCOMPLETE: Options = {"pc_type": "python", "pc_python_type": "pctt.pc.BlockICC"}
#: where a KSP fails: factors, by whether the matrix is symmetric
_FACTORS: Options = {"ksp_type": "gmres", "ksp_gmres_restart": "60", "ksp_max_it": "60"}
DIRECT = {True: {**_FACTORS, "pc_type": "cholesky"}, False: {**_FACTORS, "pc_type": "lu"}}
#: our own factors of the part of K that is worth it, by whether K is symmetric
_FRONTS: Options = {**_FACTORS, "pc_type": "python", "pc_python_type": "pctt.ccp.newton.multifrontal.MultifrontalPC"}
MULTIFRONTAL = {
    True: {**_FRONTS, "ksp_type": "cg", "ksp_norm_type": "unpreconditioned"},
    False: {**_FRONTS, "ksp_type": "fgmres"},  # bears the rounding of single precision
}
