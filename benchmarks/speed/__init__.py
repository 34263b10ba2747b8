"""Speed of training, predicting, planning and relabelling beside others; see README.md."""
