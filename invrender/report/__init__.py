"""What a person sees of a result: the page with its live viewer, pictures and numbers."""
