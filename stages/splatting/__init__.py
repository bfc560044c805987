"""The Gaussian model and the differentiable rasterizer on the CPU.

`rendering.render` draws finished Gaussians; `rasterizer.rasterize` is the differentiable function,
on numpy arrays; `torch_api.rasterization` is the same for torch, with the signature of gsplat and a
choice of backends; `reference` says in plain torch what all of them have to give; `loss` and `adam`
are the other kernels of the fit.
"""
