"""Photo → lights: the camera, the ball, and the screen and the room that the ball shows."""
