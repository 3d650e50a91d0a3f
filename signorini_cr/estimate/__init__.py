"""Guaranteed bounds.

Equilibrated flux, companion, duality gap, certificate, contact force.
"""
