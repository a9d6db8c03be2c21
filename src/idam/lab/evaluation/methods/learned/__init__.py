"""What the learned rivals share: their interface, weights, features and layers."""
