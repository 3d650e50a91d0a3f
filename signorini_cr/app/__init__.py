"""The command `signorini-cr`.

Command line, screen, problem file and its expressions.
"""
