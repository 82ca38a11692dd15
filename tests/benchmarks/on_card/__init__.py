"""Parts of `card.py`: what is measured on a machine with an NVIDIA card."""
