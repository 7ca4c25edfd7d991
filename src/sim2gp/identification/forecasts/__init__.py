"""What a posterior predicts of logs, how wide its bands are, and how both are judged."""
