"""Cells that tune stiffness, shape factor or area while the tissue relaxes, and where it then turns fluid."""

from .experiment import Config as Config, run as run
