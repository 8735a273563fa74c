"""`tactomo calibrate`: from magnitude to pressure with a load cell; `tactomo teach`: places."""
