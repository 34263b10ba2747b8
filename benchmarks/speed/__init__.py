"""Speed of training, predicting and relabelling, side by side with others; see README.md."""
