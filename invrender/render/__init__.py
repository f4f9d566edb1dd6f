"""Lights and maps → radiance and its Jacobian: the forward model."""
