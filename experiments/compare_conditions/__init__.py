"""Tell a stiff from a fluid-like epithelium by its microscopy images."""

from .experiment import Config as Config, run as run
