"""Networks that turn a capture into material maps: data, training and inference, on torch.

`nets.predict.Reconstructor` is what other code calls. `invrender` itself works without this
package.
"""
