"""Gyro error sources: one catalogue of small classes with their equations, units and sources.

Import what is needed from the module that has it: `catalogue` (the ordered list), `base` (the kinds of
effect), `truth` (what they act on), `alias` (what cannot be told apart). Nothing is loaded here.
"""
