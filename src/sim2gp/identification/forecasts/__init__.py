"""What a posterior predicts of logs, its bands, and how both are judged."""
