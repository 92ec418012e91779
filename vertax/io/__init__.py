"""Tissues in files: saving and loading, and the paper's tables."""

from vertax.io._atomic import atomic_write as atomic_write
from vertax.io._image import read_image as read_image
from vertax.io._tables import Tables as Tables
from vertax.io._tables import from_tables as from_tables
from vertax.io._tables import to_tables as to_tables
from vertax.io._tissue_file import load_tissue as load_tissue
from vertax.io._tissue_file import save_tissue as save_tissue
