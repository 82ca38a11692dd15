"""Learned networks: where their files come from, what goes in and out of each, and running them.

In go a card (`card.py`: a network's file and its contract) and images, out come depth, class probabilities or features
at the image's own pixels. Begin with `card.py` and `session.py`; `registry.py` knows the models that `models pull`
brings, `network_pass.py` runs one over all keyframes and computes nothing twice.
"""
