"""What in a picture is not part of the scene: the user's masks, and people. True = left out."""
