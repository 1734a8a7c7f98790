"""The method: feature-metric registration (Huang, Mei, Zhang, CVPR 2020) and its local form. Torch tensors in and out.

encoder.py   F: a cloud to one global feature, and its exact Jacobian at the critical points of the max pool
decoder.py   the feature back to a cloud; used in training alone
se3.py       exponential and logarithm of rigid motions
solver.py    the inverse compositional iteration
search.py    many starts over SO(3), solved as one batch
"""
