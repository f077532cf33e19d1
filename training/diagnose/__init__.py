"""The mismatch tool: from the difference between a simulation and a recording to the physics that was left out."""
