"""Mechanics: stresses, moduli and vibrational modes of tissues at rest, and slow deformations."""

from vertax.mechanics._box import BoxRelaxation as BoxRelaxation
from vertax.mechanics._elasticity import (
    bulk_modulus as bulk_modulus,
    elastic_tensor as elastic_tensor,
    shear_modulus as shear_modulus,
    youngs_modulus as youngs_modulus,
)
from vertax.mechanics._forces import pressures as pressures, tensions as tensions
from vertax.mechanics._landscape import deformed as deformed
from vertax.mechanics._modes import (
    Modes as Modes,
    density_of_states as density_of_states,
    modes as modes,
    spectrum as spectrum,
    zero_modes as zero_modes,
)
from vertax.mechanics._oscillation import complex_modulus as complex_modulus
from vertax.mechanics._ramp import (
    Ramp as Ramp,
    pure_shear as pure_shear,
    ramp as ramp,
    simple_shear as simple_shear,
)
from vertax.mechanics._recoil import recoil as recoil, velocities as velocities
from vertax.mechanics._self_stress import (
    SelfStress as SelfStress,
    compatibility as compatibility,
    self_stresses as self_stresses,
)
from vertax.mechanics._stress import (
    cell_stress as cell_stress,
    principal as principal,
    stress as stress,
)
