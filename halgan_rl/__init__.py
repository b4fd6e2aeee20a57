"""Visual hindsight experience replay for PyTorch: replay transforms, hallucinators, models; knows no simulator."""
