"""Other methods and lesser networks, small and readable, that ours is measured against."""
