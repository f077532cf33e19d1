"""The blind proof: concealed gyro recordings from physics of their own, sealed, diagnosed from outside, scored.

Nothing here imports the diagnosis, its catalogue or its simulator: an effect is a different mathematical object
than the regressor that must find it (a heat equation instead of filtered derivatives, relays instead of a play,
the exact interferometer instead of a cubic, resampled time instead of a derivative).
"""
