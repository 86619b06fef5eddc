"""What is made of finished and running trials: figures, exports, views and comparisons."""
