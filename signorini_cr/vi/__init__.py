"""The discrete variational inequality.

Its system, the active set method, when to stop, and what happens on the contact boundary.
"""
