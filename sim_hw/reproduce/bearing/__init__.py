"""The bearing whose races are damaged: figures 8 to 10 of the paper."""
