"""Networks in files of users: ONNX and torch.export. Nothing in a file is executed."""
