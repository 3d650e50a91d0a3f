"""Polygons, gmsh files and refinement.

A mesh with the parts of its boundary; nothing here knows of an equation.
"""
