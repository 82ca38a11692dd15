"""What a provider of depth or labels is given (the frames with their cameras) and what it returns."""
