"""Tensions of edges that give chosen cells the stresses asked for, by three rules of learning."""

from .experiment import Config as Config, run as run
