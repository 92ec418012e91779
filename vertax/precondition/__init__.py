"""Approximate inverses of the Hessian of a tissue, for conjugate gradients and MINRES."""
