// One step of a session for .NET 8 or newer (and Unity from 2021 on): where the tip is, what it
// feels. In a console project:
//
//   dotnet run -- ws://127.0.0.1:8000/scenes/turbinate/session 11.9 20 11
//
// The structs are the frames of version 2, little-endian like every machine that .NET runs on.
// Units: mm, mN, kPa, s. What the members mean is said in online/PROTOCOL.md and in the greeting
// that a session starts with.
using System;
using System.Globalization;
using System.IO;
using System.Net.Http;
using System.Net.WebSockets;
using System.Runtime.InteropServices;
using System.Text;
using System.Threading;
using System.Threading.Tasks;

namespace Palpate
{
    [Flags]
    public enum Output : ushort
    {
        None = 0,
        Coordinates = 1,
        Displacement = 2,
        VonMises = 4,
        Stress = 8,
        Half = 16,
        Parts = 32,
    }

    [Flags]
    public enum Flag : ushort
    {
        None = 0,
        Contact = 1,
        Converged = 2,
        InRange = 4,
        Clamped = 8,
        Fallback = 16,
        Stalled = 32,
        First = 64,
        TooDeep = 128,
        Beside = 256,
    }

    public enum Reason : uint
    {
        None = 0,
        NoEquilibrium = 1,
        BelowSurface = 2,
    }

    [StructLayout(LayoutKind.Explicit, Size = 40)]
    public struct Request
    {
        [FieldOffset(0)] public ushort Version;
        [FieldOffset(2)] public Output Outputs;
        [FieldOffset(4)] public uint Seq;
        [FieldOffset(8)] public double ClientTime;
        [FieldOffset(16)] public Vector Position;
    }

    [StructLayout(LayoutKind.Explicit, Size = 280)]
    public struct Reply
    {
        [FieldOffset(0)] public ushort Version;
        [FieldOffset(2)] public Flag Flags;
        [FieldOffset(4)] public uint Seq;
        [FieldOffset(8)] public double ClientTime;
        [FieldOffset(16)] public double ServerReceived;
        [FieldOffset(24)] public double ServerSent;
        [FieldOffset(32)] public Vector Position;
        [FieldOffset(56)] public Vector Force;
        [FieldOffset(80)] public Matrix Tangent;
        [FieldOffset(152)] public double Energy;
        [FieldOffset(160)] public float SolveTime;
        [FieldOffset(164)] public float ValidRadius;
        [FieldOffset(168)] public ShortVector ContactPoint;
        [FieldOffset(180)] public ShortVector Normal;
        [FieldOffset(192)] public float Depth;
        [FieldOffset(196)] public float Penetration;
        [FieldOffset(200)] public float ErrorDisplacement;
        [FieldOffset(204)] public float ErrorVonMises;
        [FieldOffset(208)] public float ErrorForce;
        [FieldOffset(212)] public float MinJacobian;
        [FieldOffset(216)] public float MaxVonMises;
        [FieldOffset(220)] public float P99VonMises;
        [FieldOffset(224)] public Models Model;
        [FieldOffset(240)] public Weights Weight;
        [FieldOffset(256)] public uint Superseded;
        [FieldOffset(260)] public uint Nodes;
        [FieldOffset(264)] public ushort Iterations;
        [FieldOffset(266)] public ushort Steps;
        [FieldOffset(268)] public ushort Coordinates;
        [FieldOffset(270)] public Output Outputs;
        [FieldOffset(272)] public float DepthLimit;
        [FieldOffset(276)] public Reason Reason;
    }

    [StructLayout(LayoutKind.Sequential)]
    public struct Vector
    {
        public double X, Y, Z;

        public override string ToString() =>
            string.Format(CultureInfo.InvariantCulture, "{0:R} {1:R} {2:R}", X, Y, Z);
    }

    // Rows: the force's x, y and z component, derived by the position.
    [StructLayout(LayoutKind.Sequential)]
    public struct Matrix
    {
        public Vector X, Y, Z;
    }

    [StructLayout(LayoutKind.Sequential)]
    public struct ShortVector
    {
        public float X, Y, Z;
    }

    [StructLayout(LayoutKind.Sequential)]
    public struct Models
    {
        public int First, Second, Third, Fourth;
    }

    [StructLayout(LayoutKind.Sequential)]
    public struct Weights
    {
        public float First, Second, Third, Fourth;
    }

    public sealed class Session : IDisposable
    {
        private const ushort Version = 2;

        private readonly ClientWebSocket socket = new ClientWebSocket();
        private readonly byte[] request = new byte[Marshal.SizeOf<Request>()];
        private uint seq;

        // What the service said of the scene and of its frames, JSON.
        public string Greeting { get; private set; } = "";

        public async Task Open(Uri address, CancellationToken cancel = default)
        {
            try
            {
                await socket.ConnectAsync(address, cancel);
            }
            catch (WebSocketException error)
            {
                // what a GET of the same address is told
                var scheme = address.Scheme == "wss" ? "https" : "http";
                using var client = new HttpClient();
                using var told = await client.GetAsync(
                    new UriBuilder(address) { Scheme = scheme }.Uri, cancel);
                var why = await told.Content.ReadAsStringAsync();
                throw new IOException("the session was refused: " + why, error);
            }
            Greeting = Encoding.UTF8.GetString((await Receive(cancel)).Bytes);
        }

        // Sends a position of the tip and waits for what it feels there.
        public async Task<Reply> Step(
            Vector position, double clientTime, CancellationToken cancel = default)
        {
            var frame = new Request
            {
                Version = Version,
                Seq = ++seq,
                ClientTime = clientTime,
                Position = position,
            };
            MemoryMarshal.Write(request, ref frame);
            await socket.SendAsync(
                new ArraySegment<byte>(request), WebSocketMessageType.Binary, true, cancel);
            while (true)
            {
                var (isText, bytes) = await Receive(cancel);
                if (isText)
                    throw new IOException(Encoding.UTF8.GetString(bytes));
                var reply = MemoryMarshal.Read<Reply>(bytes);
                if (reply.Version != Version)
                    throw new IOException("the reply is of another version");
                if (reply.Seq == seq)
                    return reply;
            }
        }

        public void Dispose() => socket.Dispose();

        private async Task<(bool IsText, byte[] Bytes)> Receive(CancellationToken cancel)
        {
            var buffer = new byte[8192];
            using var message = new MemoryStream();
            while (true)
            {
                var part = await socket.ReceiveAsync(new ArraySegment<byte>(buffer), cancel);
                if (part.MessageType == WebSocketMessageType.Close)
                    throw new IOException("the session was closed: " + part.CloseStatusDescription);
                message.Write(buffer, 0, part.Count);
                if (part.EndOfMessage)
                    return (part.MessageType == WebSocketMessageType.Text, message.ToArray());
            }
        }
    }

    public static class SessionStep
    {
        public static async Task Main(string[] arguments)
        {
            double Number(int i) => double.Parse(arguments[i], CultureInfo.InvariantCulture);
            using var session = new Session();
            await session.Open(new Uri(arguments[0]));
            var position = new Vector { X = Number(1), Y = Number(2), Z = Number(3) };
            var reply = await session.Step(position, Environment.TickCount64 / 1000.0);
            Console.WriteLine($"flags {reply.Flags}");
            Console.WriteLine($"position {reply.Position}");
            Console.WriteLine($"force {reply.Force}");
            Console.WriteLine($"tangent {reply.Tangent.X}");
            Console.WriteLine($"tangent {reply.Tangent.Y}");
            Console.WriteLine($"tangent {reply.Tangent.Z}");
        }
    }
}
