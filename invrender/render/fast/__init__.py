"""The nearly noise-free estimator: tables of the lights and filtered VNDF samples."""
