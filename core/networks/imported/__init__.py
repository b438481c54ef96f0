"""Networks in the ONNX format that others trained: what they are, how they are imported, and as backbones."""
