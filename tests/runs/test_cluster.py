"""Sweeps, masks, posteriors and fits on Dask clusters of two processes, and their failures."""

import os
import signal
import subprocess
import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from bayes_helpers import four_posteriors
from helpers import FIXED_TOPOLOGY, random_tissue
from typer.testing import CliRunner

import vertax as vx
from vertax._base.processes import LocalProcesses, ProcessDied
from vertax.runs import Fitting, RunFolder
from vertax.runs._sweep import sweep, sweep_runs
from vertax.runs.command_line import app

distributed = pytest.importorskip("distributed", reason="needs the extra [cluster]")
pytestmark = [pytest.mark.thorough, pytest.mark.filterwarnings("ignore")]

TINY = """
experiment = "infer_shape_factors"
tissue.n_cells = 6
fit.epochs = 2
relaxation = { contacts = false, transitions = false }
"""
CLUSTER = """
class = "distributed.LocalCluster"
workers = 2
arguments = { n_workers = 0, threads_per_worker = 1, dashboard_address = ":0" }
"""
