"""What a researcher adds: evaluation, training, charts, the paper's and other baselines."""
