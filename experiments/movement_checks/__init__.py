"""What must hold of movement in time: orders, energies, transitions, noise, gradients and steps."""

from .experiment import Config as Config, run as run
