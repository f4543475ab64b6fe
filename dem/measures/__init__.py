"""What one measures of grains and their contacts: forces per grain, stress, fabric, solid fraction, fields, mixing.

Every function takes a `Sample`: `dem.step.Step.sample` in the `record` of a scene, `pctt.Simulation.sample`, and
`pctt.analysis.sample` of the files of a run. On several ranks a sample has the grains and contacts of its rank; the
functions are collective, and their results are those of all grains, the same on all ranks.

Stresses are positive in compression. A contact adds the force f on a grain times its branch, the vector from the
contact point to the centre of the grain (Love 1927, Weber 1966); so a contact of two grains has two branches, and one
with a large body a single one. The momentum of the grains obeys d(rho u)/dt = rho g - div(stress + kinetic stress).
"""

from dem.geometry.region import Block, Cylinder
from dem.measures.coarse import Fields, fields
from dem.measures.grains import Grains, bearing, per_grain, triangle_forces
from dem.measures.profiles import Mixing, Profile, mean_position, mixing, profile
from dem.measures.sample import Sample
from dem.measures.tensors import fabric, kinetic_stress, solid_fraction, stress

__all__ = [
    "Block", "Cylinder", "Fields", "Grains", "Mixing", "Profile", "Sample", "bearing", "fabric", "fields",
    "kinetic_stress", "mean_position", "mixing", "per_grain", "profile", "solid_fraction", "stress", "triangle_forces",
]
