"""The rerun viewer: error surfaces and streams, live from zenoh or from files.

`rerun` is imported in this package only, and late.
"""
