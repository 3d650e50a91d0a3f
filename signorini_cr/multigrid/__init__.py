"""A V-cycle in the active set.

Nesting of meshes, transfers, constrained matrices, smoothing.
"""
