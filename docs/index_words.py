"""What users search for, by page and heading: entries of the index, which the search puts first."""

from __future__ import annotations

WORDS = {
    "accuracy": {"": "accuracy, convergence", "If a solver does not converge": "not converged"},
    "ccp": {"Coulomb's law and its relaxation": "Coulomb's law", "Hand over a cone problem": "cone problem, LCP, NCP"},
    "choose": {"": "dt, time step, tolerance"},
    "cluster": {
        "": "MPI, ranks, parallel, cluster",
        "How to start a run": "Slurm, mpiexec, srun",
        "Threads within a rank": "threads, OpenMP",
        "Files and memory": "memory",
    },
    "contact_laws": {
        "": "friction, friction coefficient, contact law, material",
        "Cohesion": "cohesion, adhesion, JKR, DMT",
        "Capillary bridges": "capillary bridge, liquid bridge",
        "Rolling and spinning": "rolling, rolling friction, rolling resistance, spinning",
    },
    "faq": {"Questions": "GPU, CUDA", "Messages of a run": "warning, error message"},
    "files": {"What a run leaves": "CSV, HDF5, output, output files", "Cone problems in files": "FCLIB"},
    "install": {"A container": "Docker, Apptainer, Podman, Singularity"},
    "loads": {
        "Forces and torques": "force, torque, load, drag",
        "Belts": "belt, conveyor",
        "Wheels and other bodies that are held in part": "wheel",
        "Springs and dampers": "spring, damper, damping",
        "Joints and motors": "joint, hinge, slider, motor, servo",
    },
    "looking": {
        "Pictures and films: pctt.render": "film, video, animation, picture, rendering",
        "ParaView: pctt.export": "ParaView, VTK, VTKHDF, force chain",
        "Figures: pctt.plot": "plot, figure",
    },
    "measurements": {"": "speed, performance", "Beside LIGGGHTS": "LIGGGHTS", "Chrono": "Chrono"},
    "measuring": {"": "stress, stress tensor, fabric, solid fraction, porosity, coarse graining, mixing index"},
    "mechanics": {
        "The stiffness of contacts": "stiffness, Young's modulus, Hertz",
        "Restitution": "restitution, coefficient of restitution, bounce",
        "Overlaps that remain": "overlap, penetration",
        "Shapes and contacts": "shape",
    },
    "methods": {"": "APGD, interior point method"},
    "mujoco": {"": "MuJoCo, Drake, URDF"},
    "options": {"": "option, command line"},
    "periodic": {"": "periodic, periodic boundary", "Stress and strain": "triaxial test", "Shear": "Lees-Edwards"},
    "preconditioners": {"": "PETSc, preconditioner, KSP"},
    "python": {"": "Jupyter, notebook, script", "Sweeps and several simulations": "sweep"},
    "scenes": {
        "Tools from STL and OBJ files": "STL, OBJ, mesh, CAD",
        "Clumps of spheres": "clump, multisphere",
        "Convex polyhedra": "polyhedra, polyhedron",
        "Cylinders and superellipsoids": "cylinder, ellipsoid, superquadric",
        "Settling": "settle, settling",
        "Going on from a checkpoint": "restart, checkpoint, resume",
        "Records of every scene": "energy",
    },
    "solvers": {"": "solver"},
    "sources": {
        "Sources": "source, inlet, feeder, particle size distribution, polydisperse, insertion",
        "Outlets": "outlet",
        "Packings": "packing",
        "Beds of other programs": "LAMMPS, Yade, import",
    },
    "trains": {"": "tensor train, dense matrix"},
    "tutorial": {
        "Bodies and materials": "gravity, density, wall, container",
        "Motions of large bodies": "motion, rotation",
    },
    "validation": {"What was done": "heap, silo flow, benchmark"},
}
