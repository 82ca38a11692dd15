"""Learned depth and classes: any ONNX network that a card describes."""
