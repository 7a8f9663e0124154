"""What every training loop needs: seeds, optimiser and schedule, checkpoints, curves and progress bars.

There is no trainer object. A recipe writes its own loop and calls these pieces.
"""
