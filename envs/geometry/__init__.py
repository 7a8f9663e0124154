"""Pure, batched, masked geometry on tensors: frames, boxes and road edges."""
