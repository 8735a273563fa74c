"""Training the fusion networks: scenes are simulated, networks trained and exported to ONNX.

PyTorch is imported in here alone, and joblib with it: `pip install 'tactomo[train]'`. What runs a
trained network, `tactomo_models.network`, needs neither.
"""
