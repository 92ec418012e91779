"""Utilities without physics: argument checks, tracing, pytrees, files, compilation."""
