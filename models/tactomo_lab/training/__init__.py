"""Training the fusion networks: scenes are simulated, networks trained and exported to ONNX.

PyTorch is imported in here alone: `pip install 'tactomo-lab[train]'`. What runs a
trained network, `tactomo_models.methods.trained_networks`, does not need it.
"""
