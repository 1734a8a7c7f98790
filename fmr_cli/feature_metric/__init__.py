"""The method: feature-metric registration (Huang, Mei, Zhang, CVPR 2020) and its local form. No files, no options.

inverse_compositional.py   the iteration and all its equations, for numpy and torch alike
encoder.py                 F in torch: a cloud to one global feature, and its exact Jacobian at the critical points
decoder.py                 the feature back to a cloud; used in training alone
solver.py                  the iteration on the torch encoder: batches, GPUs; the paper's finite differences
numpy_encoder.py           F without torch, as it runs for a pair on the CPU
numpy_solver.py            the iteration on that, which looks at few points of a large source
search.py                  many starts over SO(3), solved as one batch
patches.py                 the metric patch by patch, for part overlap
layers.py                  a network's weights in numpy
"""
